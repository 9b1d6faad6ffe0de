// Copyright 2026 The diffdrive_jacobian developers
//
// Licensed under the Apache License, Version 2.0 (the "License");
// you may not use this file except in compliance with the License.
// You may obtain a copy of the License at
//
//     http://www.apache.org/licenses/LICENSE-2.0
//
// Unless required by applicable law or agreed to in writing, software
// distributed under the License is distributed on an "AS IS" BASIS,
// WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
// See the License for the specific language governing permissions and
// limitations under the License.

/* Put before the libraries of a program: its clocks, sleeps and waits with a timeout follow a lockstep world.
 *
 *     gcc -shared -fPIC -O2 -pthread -o simulated_wall_time.so simulated_wall_time.c -ldl
 *     LD_PRELOAD=.../simulated_wall_time.so LOCKSTEP_WALL_TIME=/proc/PID/fd/N program
 *
 * LOCKSTEP_WALL_TIME is a `struct page` that the world has created. Who waits with a timeout enters it in a
 * slot and waits without one, until what it waits for happens, or the world gives the slot back because its
 * time has come: one slot after the other, so that the order is determined. DDS keeps real time: what
 * libraries of Fast DDS call is passed on. A futex, `turn`, is counted up with whatever waits may end by.
 *
 * Waits of executors (`rmw_wait`) and for files (poll, select, epoll) end by a guard condition and by a file
 * that a thread of this library triggers. Condition variables and semaphores are waited for on `turn`: who
 * signals one counts it up; that others wake up for no reason is allowed to them.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <link.h>
#include <linux/futex.h>
#include <poll.h>
#include <pthread.h>
#include <semaphore.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/mman.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

#define PUBLIC __attribute__((visibility("default")))
#define CALLER __builtin_return_address(0)
#define SECOND 1000000000LL

/* --- Shared with the world: keep `wall_time.py` as it is here. */

enum { SLOTS = 250, PROCESSES = 32 };
enum state { FREE, TAKEN, WAITS, DUE };
struct slot { _Atomic int64_t until; _Atomic int32_t state, thread; /* negative: of an executor */ };
struct page {
  _Atomic int64_t steady, system; /* ns */
  _Atomic int64_t ended;          /* 0; or when real time goes on from there, because the program ends (ns) */
  _Atomic int32_t turn, full, waiters; /* `waiters` of condition variables and semaphores */
  _Atomic int32_t spinning;            /* main threads in `rmw_wait` */
  _Atomic int32_t processes[PROCESSES];
  char refused[64]; /* a function that cannot follow simulated time */
  struct slot slots[SLOTS];
};
static struct page *page;

/* --- Real time and who calls */

#define REAL(name) \
  static __typeof__(&name) real; \
  if (!real) real = (__typeof__(&name))dlsym(RTLD_NEXT, #name)

static int64_t real_now(clockid_t clock) {
  static int (*real)(clockid_t, struct timespec *);
  if (!real) real = dlsym(RTLD_NEXT, "clock_gettime");
  struct timespec t;
  real(clock, &t);
  return t.tv_sec * SECOND + t.tv_nsec;
}

enum caller { PROGRAM, DDS, PYTHON, STANDARD };
static struct range { uintptr_t begin, end; enum caller who; } ranges[256];
static _Atomic int known;

static enum caller kind_of(const char *path) {
  char exe[PATH_MAX] = "";
  if (!*path && readlink("/proc/self/exe", exe, sizeof exe - 1) > 0) path = exe;
  const char *name = strrchr(path, '/') ? strrchr(path, '/') + 1 : path;
  if (strstr(name, "fastrtps") || strstr(name, "fastdds") || strstr(name, "fastcdr")) return DDS;
  if (!strncmp(name, "libstdc++", 9)) return STANDARD;
  return !strncmp(name, "libpython", 9) || !strncmp(name, "python", 6) ? PYTHON : PROGRAM;
}

struct search { uintptr_t address; struct range found; };

static int compare(struct dl_phdr_info *info, size_t size, void *data) {
  (void)size;
  struct search *search = data;
  for (int i = 0; i < info->dlpi_phnum; i++) {
    const ElfW(Phdr) *part = &info->dlpi_phdr[i];
    uintptr_t begin = info->dlpi_addr + part->p_vaddr;
    if (part->p_type == PT_LOAD && search->address - begin < part->p_memsz) {
      search->found = (struct range){begin, begin + part->p_memsz, kind_of(info->dlpi_name)};
      return 1;
    }
  }
  return 0;
}

static enum caller who(void *address) {
  uintptr_t at = (uintptr_t)address;
  int number = known;
  for (int i = 0; i < number; i++)
    if (at - ranges[i].begin < ranges[i].end - ranges[i].begin) return ranges[i].who;
  static pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;
  struct search search = {at, {0, 0, PROGRAM}};
  dl_iterate_phdr(compare, &search);
  pthread_mutex_lock(&mutex);
  if (search.found.end && known < 256) {
    ranges[known] = search.found;
    known++;
  }
  pthread_mutex_unlock(&mutex);
  return search.found.who;
}

/* --- Simulated time */

static int simulated(void *caller) { return page && who(caller) != DDS; }
static int ended(void) { return page->ended != 0; }
static int64_t passed(void) { return ended() ? real_now(CLOCK_MONOTONIC) - page->ended : 0; }
static int64_t steady(void) { return page->steady + passed(); }
static int is_system(clockid_t clock) { return clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE; }
static int is_steady(clockid_t clock) {
  return clock == CLOCK_MONOTONIC || clock == CLOCK_MONOTONIC_RAW || clock == CLOCK_MONOTONIC_COARSE ||
         clock == CLOCK_BOOTTIME;
}
static int64_t now(clockid_t clock) { return is_system(clock) ? page->system + passed() : steady(); }
static int64_t ns(const struct timespec *t) {
  return t->tv_sec > INT64_MAX / SECOND / 2 ? INT64_MAX / 2 : t->tv_sec * SECOND + t->tv_nsec;
}
static struct timespec spec(int64_t t) { return (struct timespec){t / SECOND, t % SECOND}; }
static struct timespec real_until(int64_t until, clockid_t clock) {
  int64_t left = until - steady();
  return spec(real_now(clock) + (left > 0 ? left : 0));
}

static long futex_wait(_Atomic int32_t *word, int32_t value) {
  return syscall(SYS_futex, word, FUTEX_WAIT, value, NULL, NULL, 0);
}

static void count_up(void) {
  page->turn++;
  syscall(SYS_futex, &page->turn, FUTEX_WAKE, INT_MAX, NULL, NULL, 0);
}

/* What ends the wait of a slot of this process, for those that do not wait on `turn`. */
static struct { int file; void *guard; } ends[SLOTS];
static pthread_mutex_t ends_mutex = PTHREAD_MUTEX_INITIALIZER;
static int (*trigger)(const void *);
static _Thread_local int32_t own_thread;
static _Thread_local int64_t idle_since, idle_step = 1000;
static _Thread_local int idle_times;

static struct slot *enter_as(int64_t until, int executor) {
  if (!own_thread) own_thread = syscall(SYS_gettid);
  for (;;) {
    int32_t turn = page->turn;
    for (int i = 0; i < SLOTS; i++) {
      int32_t free = FREE;
      if (atomic_compare_exchange_strong(&page->slots[i].state, &free, TAKEN)) {
        page->slots[i].until = until;
        page->slots[i].thread = executor ? -own_thread : own_thread;
        page->slots[i].state = WAITS;
        return &page->slots[i];
      }
    }
    page->full = 1; /* which is an error of the world */
    futex_wait(&page->turn, turn);
  }
}
static void end_by(struct slot *slot, int file, void *guard) {
  pthread_mutex_lock(&ends_mutex);
  ends[slot - page->slots].file = file;
  ends[slot - page->slots].guard = guard;
  pthread_mutex_unlock(&ends_mutex);
}
static struct slot *enter(int64_t until) { return enter_as(until, 0); }
static void leave(struct slot *slot) {
  idle_step = 1000;
  slot->state = FREE;
}
static int is_due(struct slot *slot) { return slot->state == DUE || ended(); }

static void *watch(void *nothing) {
  (void)nothing;
  for (;;) {
    int32_t turn = page->turn;
    pthread_mutex_lock(&ends_mutex);
    for (int i = 0; i < SLOTS; i++)
      if (is_due(&page->slots[i])) {
        ssize_t written = ends[i].file ? write(ends[i].file, &(uint64_t){1}, 8) : 0;
        (void)written; /* It is full at most. */
        if (ends[i].guard) trigger(ends[i].guard);
        ends[i].file = 0;
        ends[i].guard = NULL;
      }
    pthread_mutex_unlock(&ends_mutex);
    futex_wait(&page->turn, turn);
  }
  return NULL;
}

static void start_to_watch(void) {
  pthread_t thread;
  sigset_t all, before;
  sigfillset(&all);
  pthread_sigmask(SIG_SETMASK, &all, &before);
  pthread_create(&thread, NULL, watch, NULL);
  pthread_setname_np(thread, "wall_time");
  pthread_sigmask(SIG_SETMASK, &before, NULL);
}

static _Atomic int watching;
static void watch_once(void) {
  if (!atomic_exchange(&watching, 1)) start_to_watch();
}

static void forked(void) {
  own_thread = 0;
  watching = 0;
  memset(ends, 0, sizeof ends);
  pthread_mutex_init(&ends_mutex, NULL);
}

static void refuse(const char *name) {
  if (page && !page->refused[0]) strncpy(page->refused, name, sizeof page->refused - 1);
}

__attribute__((constructor)) static void start(void) {
  const char *path = getenv("LOCKSTEP_WALL_TIME");
  int file = path ? open(path, O_RDWR | O_CLOEXEC) : -1;
  if (file < 0) return;
  void *mapped = mmap(NULL, sizeof *page, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
  close(file);
  if (mapped == MAP_FAILED) return;
  page = mapped;
  for (int i = 0; i < PROCESSES; i++) {
    int32_t there = page->processes[i];
    if (there && (!kill(there, 0) || errno != ESRCH)) continue;
    if (atomic_compare_exchange_strong(&page->processes[i], &there, getpid())) break;
  }
  pthread_atfork(NULL, NULL, forked);
}

static int sleep_until(int64_t until);

/* A loop that looks at the clock, or for files, without waiting would never end where time stands. */
static void look(int most) {
  int64_t time = page->steady;
  if (idle_since != time) idle_times = 0;
  idle_since = time;
  if (ended() || ++idle_times < most) return;
  int64_t step = idle_step;
  sleep_until(steady() + step);
  idle_times = 0;
  idle_step = step < 1000000 ? 2 * step : step;
}
enum { CLOCK_READINGS = 10000, EMPTY_LOOKS = 500 };

/* --- Clocks */

PUBLIC int clock_gettime(clockid_t clock, struct timespec *t) {
  REAL(clock_gettime);
  if (!page || !(is_system(clock) || is_steady(clock))) return real(clock, t);
  enum caller caller = who(CALLER);
  if (caller == DDS || caller == STANDARD) return real(clock, t);
  look(CLOCK_READINGS);
  *t = spec(now(clock));
  return 0;
}

PUBLIC int gettimeofday(struct timeval *restrict t, void *restrict zone) {
  (void)zone;
  int64_t time = simulated(CALLER) ? now(CLOCK_REALTIME) : real_now(CLOCK_REALTIME);
  *t = (struct timeval){time / SECOND, time % SECOND / 1000};
  return 0;
}

PUBLIC time_t time(time_t *t) {
  time_t found = (simulated(CALLER) ? now(CLOCK_REALTIME) : real_now(CLOCK_REALTIME)) / SECOND;
  if (t) *t = found;
  return found;
}

/* std::chrono::steady_clock::now and system_clock::now: what they call would be called by libstdc++. */
static int64_t chrono_now(void *caller, clockid_t clock) {
  if (!simulated(caller)) return real_now(clock);
  look(CLOCK_READINGS);
  return now(clock);
}
PUBLIC int64_t _ZNSt6chrono3_V212steady_clock3nowEv(void) { return chrono_now(CALLER, CLOCK_MONOTONIC); }
PUBLIC int64_t _ZNSt6chrono3_V212system_clock3nowEv(void) { return chrono_now(CALLER, CLOCK_REALTIME); }

PUBLIC int timespec_get(struct timespec *t, int base) {
  *t = spec(chrono_now(CALLER, CLOCK_REALTIME));
  return base;
}

/* --- Sleeps */

static int sleep_until(int64_t until) {
  int interrupted = 0;
  if (!ended() && until > steady()) {
    struct slot *slot = enter(until);
    while (!is_due(slot) && !interrupted) {
      int32_t turn = page->turn;
      if (!is_due(slot)) interrupted = futex_wait(&page->turn, turn) && errno == EINTR;
    }
    leave(slot);
  }
  if (!interrupted && ended() && until > steady()) {
    struct timespec left = spec(until - steady());
    interrupted = syscall(SYS_clock_nanosleep, CLOCK_MONOTONIC, 0, &left, NULL) != 0;
  }
  return interrupted ? EINTR : 0;
}

PUBLIC int clock_nanosleep(clockid_t clock, int flags, const struct timespec *t, struct timespec *left) {
  REAL(clock_nanosleep);
  if (!simulated(CALLER)) return real(clock, flags, t, left);
  int64_t until = steady() + ns(t) - (flags & TIMER_ABSTIME ? now(clock) : 0);
  int error = sleep_until(until);
  if (error && left && !(flags & TIMER_ABSTIME)) *left = spec(until > steady() ? until - steady() : 0);
  return error;
}

PUBLIC int nanosleep(const struct timespec *t, struct timespec *left) {
  REAL(nanosleep);
  if (!simulated(CALLER)) return real(t, left);
  int64_t until = steady() + ns(t);
  if (!(errno = sleep_until(until))) return 0;
  if (left) *left = spec(until > steady() ? until - steady() : 0);
  return -1;
}

PUBLIC int usleep(useconds_t us) {
  REAL(usleep);
  if (!simulated(CALLER)) return real(us);
  return (errno = sleep_until(steady() + us * 1000LL)) ? -1 : 0;
}

PUBLIC unsigned sleep(unsigned seconds) {
  REAL(sleep);
  if (!simulated(CALLER)) return real(seconds);
  int64_t until = steady() + seconds * SECOND;
  return sleep_until(until) ? (until - steady()) / SECOND : 0;
}

/* --- Condition variables */

static _Atomic uint32_t signals[256];
static _Atomic uint32_t *signals_of(const void *address) { return &signals[(uintptr_t)address / 16 % 256]; }

static int wait_signal(pthread_cond_t *condition, pthread_mutex_t *mutex, int64_t until) {
  if (until <= steady()) return ETIMEDOUT;
  _Atomic uint32_t *number = signals_of(condition);
  page->waiters++;
  uint32_t before = *number;
  struct slot *slot = enter(until);
  pthread_mutex_unlock(mutex);
  while (!is_due(slot) && *number == before) {
    int32_t turn = page->turn;
    if (!is_due(slot) && *number == before) futex_wait(&page->turn, turn);
  }
  int timed_out = *number == before && !ended();
  leave(slot);
  page->waiters--;
  pthread_mutex_lock(mutex);
  return timed_out ? ETIMEDOUT : 0;
}

PUBLIC int pthread_cond_clockwait(
    pthread_cond_t *condition, pthread_mutex_t *mutex, clockid_t clock, const struct timespec *t) {
  REAL(pthread_cond_clockwait);
  if (!simulated(CALLER)) return real(condition, mutex, clock, t);
  int64_t until = steady() + ns(t) - now(clock);
  if (!ended()) return wait_signal(condition, mutex, until);
  struct timespec later = real_until(until, CLOCK_MONOTONIC);
  return real(condition, mutex, CLOCK_MONOTONIC, &later);
}

PUBLIC int pthread_cond_timedwait(pthread_cond_t *condition, pthread_mutex_t *mutex, const struct timespec *t) {
  REAL(pthread_cond_timedwait);
  if (!page) return real(condition, mutex, t);
  enum caller caller = who(CALLER);
  if (caller == DDS) return real(condition, mutex, t);
  /* As its attribute says: a bit of the condition variable, since glibc 2.25. */
  clockid_t clock = condition->__data.__wrefs & 2 ? CLOCK_MONOTONIC : CLOCK_REALTIME;
  int64_t until = steady() + ns(t) - now(clock);
  /* Not the lock of the interpreter: for 5 ms while another thread of Python runs. */
  if (caller != PYTHON && !ended()) return wait_signal(condition, mutex, until);
  struct timespec later = real_until(until, clock);
  return real(condition, mutex, &later);
}

static void count_signal(void *address) {
  if (page && page->waiters) {
    ++*signals_of(address);
    count_up();
  }
}

PUBLIC int pthread_cond_signal(pthread_cond_t *condition) {
  static int (*real)(pthread_cond_t *);
  if (!real) real = dlvsym(RTLD_NEXT, "pthread_cond_signal", "GLIBC_2.3.2");
  if (!real) real = dlsym(RTLD_NEXT, "pthread_cond_signal");
  count_signal(condition);
  return real(condition);
}

PUBLIC int pthread_cond_broadcast(pthread_cond_t *condition) {
  static int (*real)(pthread_cond_t *);
  if (!real) real = dlvsym(RTLD_NEXT, "pthread_cond_broadcast", "GLIBC_2.3.2");
  if (!real) real = dlsym(RTLD_NEXT, "pthread_cond_broadcast");
  count_signal(condition);
  return real(condition);
}

/* --- Semaphores: locks of Python with a timeout */

static int wait_semaphore(sem_t *semaphore, int64_t until) {
  int error = 0;
  page->waiters++;
  struct slot *slot = NULL;
  while (sem_trywait(semaphore) && errno == EAGAIN) {
    if (slot ? is_due(slot) : until <= steady()) {
      error = ETIMEDOUT;
      break;
    }
    if (!slot) slot = enter(until);
    int32_t turn = page->turn;
    if (!sem_trywait(semaphore)) break;
    if (!is_due(slot) && futex_wait(&page->turn, turn) && errno == EINTR) {
      error = EINTR;
      break;
    }
  }
  if (slot) leave(slot);
  page->waiters--;
  errno = error;
  return error ? -1 : 0;
}

PUBLIC int sem_clockwait(sem_t *semaphore, clockid_t clock, const struct timespec *t) {
  REAL(sem_clockwait);
  if (!simulated(CALLER)) return real(semaphore, clock, t);
  int64_t until = steady() + ns(t) - now(clock);
  if (!ended()) return wait_semaphore(semaphore, until);
  struct timespec later = real_until(until, CLOCK_MONOTONIC);
  return real(semaphore, CLOCK_MONOTONIC, &later);
}

PUBLIC int sem_timedwait(sem_t *semaphore, const struct timespec *t) {
  REAL(sem_timedwait);
  if (!simulated(CALLER)) return real(semaphore, t);
  int64_t until = steady() + ns(t) - now(CLOCK_REALTIME);
  if (!ended()) return wait_semaphore(semaphore, until);
  struct timespec later = real_until(until, CLOCK_REALTIME);
  return real(semaphore, &later);
}

PUBLIC int sem_post(sem_t *semaphore) {
  REAL(sem_post);
  int result = real(semaphore);
  if (page && page->waiters) count_up();
  return result;
}

/* --- Files */

/* Wait for files without a timeout, and for one more file, which the end of the slot writes. */
static int wait_files(struct pollfd *files, nfds_t number, int64_t until, const sigset_t *mask) {
  struct pollfd *all = alloca((number + 1) * sizeof *all);
  memcpy(all, files, number * sizeof *all);
  int file = eventfd(0, EFD_CLOEXEC);
  if (file < 0) refuse("poll without a free file descriptor");
  if (file < 0) return -1;
  all[number] = (struct pollfd){file, POLLIN, 0};
  watch_once();
  struct slot *slot = enter(until);
  end_by(slot, file, NULL);
  if (ended()) count_up();
  int found = ppoll(all, number + 1, NULL, mask), error = errno;
  end_by(slot, 0, NULL);
  leave(slot);
  close(file);
  memcpy(files, all, number * sizeof *all);
  errno = error;
  return found > 0 && all[number].revents ? found - 1 : found;
}

PUBLIC int ppoll(struct pollfd *files, nfds_t number, const struct timespec *t, const sigset_t *mask) {
  REAL(ppoll);
  if (!t || !simulated(CALLER) || ended()) return real(files, number, t, mask);
  struct timespec none = {0, 0};
  int found = real(files, number, &none, mask);
  return found || ns(t) <= 0 ? found : wait_files(files, number, steady() + ns(t), mask);
}

PUBLIC int poll(struct pollfd *files, nfds_t number, int ms) {
  REAL(poll);
  if (ms < 0 || !simulated(CALLER) || ended()) return real(files, number, ms);
  int found = real(files, number, 0);
  if (!found && !ms) look(EMPTY_LOOKS);
  return found || !ms ? found : wait_files(files, number, steady() + ms * 1000000LL, NULL);
}

/* With _FORTIFY_SOURCE. */
PUBLIC int __poll_chk(struct pollfd *files, nfds_t number, int ms, size_t size) {
  if (size / sizeof *files < number) abort();
  if (!simulated(CALLER) || ms <= 0 || ended()) return ppoll(files, number, ms < 0 ? NULL : &(struct timespec){ms / 1000, ms % 1000 * 1000000L}, NULL);
  return poll(files, number, ms);
}

static int epoll_until(int epoll, struct epoll_event *events, int most, int ms, const sigset_t *mask) {
  int found = epoll_pwait(epoll, events, most, 0, mask);
  if (found || ms <= 0) return found;
  struct pollfd file = {epoll, POLLIN, 0};
  found = wait_files(&file, 1, steady() + ms * 1000000LL, mask);
  return found > 0 ? epoll_pwait(epoll, events, most, 0, mask) : found;
}

PUBLIC int epoll_pwait(int epoll, struct epoll_event *events, int most, int ms, const sigset_t *mask) {
  REAL(epoll_pwait);
  if (ms <= 0 || !simulated(CALLER) || ended()) return real(epoll, events, most, ms, mask);
  return epoll_until(epoll, events, most, ms, mask);
}

PUBLIC int epoll_wait(int epoll, struct epoll_event *events, int most, int ms) {
  REAL(epoll_wait);
  if (ms <= 0 || !simulated(CALLER) || ended()) return real(epoll, events, most, ms);
  return epoll_until(epoll, events, most, ms, NULL);
}

static int select_until(int number, fd_set *sets[3], int64_t until, const sigset_t *mask) {
  static const short asked[] = {POLLIN, POLLOUT, POLLPRI};
  struct pollfd files[FD_SETSIZE];
  nfds_t count = 0;
  for (int file = 0; file < number; file++) {
    short events = 0;
    for (int i = 0; i < 3; i++)
      if (sets[i] && FD_ISSET(file, sets[i])) events |= asked[i];
    if (events) files[count++] = (struct pollfd){file, events, 0};
  }
  if (wait_files(files, count, until, mask) < 0) return -1;
  int found = 0;
  for (int i = 0; i < 3; i++)
    if (sets[i]) FD_ZERO(sets[i]);
  for (nfds_t k = 0; k < count; k++)
    for (int i = 0; i < 3; i++)
      if (sets[i] && files[k].events & asked[i] && files[k].revents & (asked[i] | POLLHUP | POLLERR)) {
        FD_SET(files[k].fd, sets[i]);
        found++;
      }
  return found;
}

PUBLIC int select(int number, fd_set *read, fd_set *write, fd_set *except, struct timeval *t) {
  REAL(select);
  if (!t || !simulated(CALLER) || ended()) return real(number, read, write, except, t);
  int64_t duration = t->tv_sec * SECOND + t->tv_usec * 1000LL;
  if (duration <= 0) look(EMPTY_LOOKS);
  if (duration <= 0) return real(number, read, write, except, t);
  if (!number) return (errno = sleep_until(steady() + duration)) ? -1 : 0;
  return select_until(number, (fd_set *[]){read, write, except}, steady() + duration, NULL);
}

PUBLIC int pselect(
    int number, fd_set *read, fd_set *write, fd_set *except, const struct timespec *t, const sigset_t *mask) {
  REAL(pselect);
  if (!t || ns(t) <= 0 || !simulated(CALLER) || ended()) return real(number, read, write, except, t, mask);
  return select_until(number, (fd_set *[]){read, write, except}, steady() + ns(t), mask);
}

/* --- Futures and atomics of libstdc++, which call the system themselves */

struct waiter { uint64_t value, address; uint32_t flags, reserved; };

PUBLIC long syscall(long number, ...) {
  static long (*real)(long, ...);
  if (!real) real = dlsym(RTLD_NEXT, "syscall");
  va_list list;
  va_start(list, number);
  long a = va_arg(list, long), b = va_arg(list, long), c = va_arg(list, long), d = va_arg(list, long),
       e = va_arg(list, long), f = va_arg(list, long);
  va_end(list);
  int operation = b & FUTEX_CMD_MASK;
  if (number != SYS_futex || !d || (operation != FUTEX_WAIT && operation != FUTEX_WAIT_BITSET) ||
      !simulated(CALLER) || ended())
    return real(number, a, b, c, d, e, f);
  int64_t time = ns((const struct timespec *)d);
  int64_t until = steady() + time;
  if (operation == FUTEX_WAIT_BITSET)
    until -= now(b & FUTEX_CLOCK_REALTIME ? CLOCK_REALTIME : CLOCK_MONOTONIC);
  int error = until <= steady() ? ETIMEDOUT : 0;
  struct slot *slot = error ? NULL : enter(until);
  while (slot && !error) {
    struct waiter both[2] = {{(uint32_t)c, a, 2 | (b & FUTEX_PRIVATE_FLAG), 0},
                             {(uint32_t)page->turn, (uintptr_t)&page->turn, 2, 0}};
    if (is_due(slot)) {
      error = ETIMEDOUT;
      break;
    }
    long woken = real(449 /* futex_waitv */, both, 2, 0, NULL, 0);
    if (woken < 0 && (errno == ENOSYS || errno == EPERM)) refuse("a future, which needs Linux 5.16");
    if (woken == 0) break;
    if (woken < 0 && errno == EAGAIN && *(_Atomic uint32_t *)a == (uint32_t)c) continue;
    if (woken < 0) error = errno;
  }
  if (slot) leave(slot);
  errno = error;
  return error ? -1 : 0;
}

/* --- Executors */

struct guard { void *implementation, *data, *context; };
struct guards { size_t count; void **entries; };
struct others { size_t count; void **entries; };
enum { SETS = 256 };
static struct { void *_Atomic wait_set; struct guard_condition *guard; } sets[SETS];
struct guard_condition { const char *implementation; void *data; void *context; };
static pthread_mutex_t sets_mutex = PTHREAD_MUTEX_INITIALIZER;

static int find(struct dl_phdr_info *info, size_t size, void *found) {
  (void)size;
  int first = strstr(info->dlpi_name, "librmw_implementation.so") != NULL;
  if (first || strstr(info->dlpi_name, "librmw_fastrtps_cpp.so")) *(const char **)found = info->dlpi_name;
  return first;
}

/* Libraries of modules of Python are not found otherwise. */
static void *of_rmw(const char *name) {
  static void *library;
  const char *path = NULL;
  if (!library) dl_iterate_phdr(find, &path);
  if (path) library = dlopen(path, RTLD_LAZY | RTLD_NOLOAD);
  void *found = dlsym(library ? library : RTLD_NEXT, name);
  if (!found) abort();
  return found;
}

PUBLIC void *rmw_create_wait_set(void *context, size_t most) {
  void *(*real)(void *, size_t) = of_rmw("rmw_create_wait_set");
  void *wait_set = real(context, most ? most + 1 : 0);
  if (!page || !wait_set) return wait_set;
  struct guard_condition *(*create)(void *) = of_rmw("rmw_create_guard_condition");
  trigger = of_rmw("rmw_trigger_guard_condition");
  watch_once();
  int i = 0;
  pthread_mutex_lock(&sets_mutex);
  while (i < SETS && sets[i].wait_set) i++;
  if (i < SETS) sets[i].guard = create(context);
  if (i < SETS) sets[i].wait_set = wait_set;
  pthread_mutex_unlock(&sets_mutex);
  if (i == SETS) refuse("rmw_create_wait_set too often");
  return wait_set;
}

PUBLIC int rmw_destroy_wait_set(void *wait_set) {
  int (*real)(void *) = of_rmw("rmw_destroy_wait_set");
  int (*destroy)(void *) = of_rmw("rmw_destroy_guard_condition");
  struct guard_condition *guard = NULL;
  pthread_mutex_lock(&sets_mutex);
  for (int i = 0; page && i < SETS; i++)
    if (sets[i].wait_set == wait_set) {
      guard = sets[i].guard;
      sets[i].wait_set = NULL;
    }
  pthread_mutex_unlock(&sets_mutex);
  int result = real(wait_set);
  if (guard) destroy(guard);
  return result;
}

static int any(const struct others *ready) {
  for (size_t i = 0; ready && i < ready->count; i++)
    if (ready->entries[i]) return 1;
  return 0;
}

struct duration { uint64_t sec, nsec; };
enum { RMW_RET_TIMEOUT = 2 };

static int wait_in_rmw(
    struct others *subscriptions, struct guards *guards, struct others *services, struct others *clients,
    struct others *events, void *wait_set, const struct duration *t) {
  static int (*real)(void *, void *, void *, void *, void *, void *, const void *);
  if (!real) real = of_rmw("rmw_wait");
  struct guard_condition *guard = NULL;
  for (int i = 0; page && i < SETS && !guard; i++)
    if (sets[i].wait_set == wait_set) guard = sets[i].guard;
  if (!t || !(t->sec || t->nsec) || !guard || ended()) {
    int result = real(subscriptions, guards, services, clients, events, wait_set, t);
    if (t && guard && result == RMW_RET_TIMEOUT) look(EMPTY_LOOKS);
    return result;
  }
  size_t number = guards ? guards->count : 0;
  void **entries = alloca((number + 1) * sizeof *entries);
  if (number) memcpy(entries, guards->entries, number * sizeof *entries);
  entries[number] = guard->data;
  struct guards more = {number + 1, entries};
  int64_t until = t->sec > INT64_MAX / SECOND / 2 ? INT64_MAX / 2 : steady() + t->sec * SECOND + t->nsec;
  struct slot *slot = enter_as(until, 1);
  end_by(slot, 0, guard);
  if (ended()) count_up();
  int result = real(subscriptions, &more, services, clients, events, wait_set, NULL);
  end_by(slot, 0, NULL);
  leave(slot);
  if (number) memcpy(guards->entries, entries, number * sizeof *entries);
  struct others given = {number, entries};
  int ready = any(subscriptions) || any(&given) || any(services) || any(clients) || any(events);
  return result ? result : ready ? 0 : RMW_RET_TIMEOUT;
}

PUBLIC int rmw_wait(
    struct others *subscriptions, struct guards *guards, struct others *services, struct others *clients,
    struct others *events, void *wait_set, const struct duration *t) {
  int spins = page && (!t || t->sec || t->nsec) && syscall(SYS_gettid) == getpid();
  if (spins) page->spinning++;
  int result = wait_in_rmw(subscriptions, guards, services, clients, events, wait_set, t);
  if (spins) page->spinning--;
  return result;
}

/* --- What does not follow */

PUBLIC int pthread_mutex_timedlock(pthread_mutex_t *mutex, const struct timespec *t) {
  REAL(pthread_mutex_timedlock);
  if (!simulated(CALLER)) return real(mutex, t);
  if (pthread_mutex_trylock(mutex) == 0) return 0;
  refuse("pthread_mutex_timedlock");
  return ETIMEDOUT;
}

PUBLIC int pthread_mutex_clocklock(pthread_mutex_t *mutex, clockid_t clock, const struct timespec *t) {
  REAL(pthread_mutex_clocklock);
  if (!simulated(CALLER)) return real(mutex, clock, t);
  if (pthread_mutex_trylock(mutex) == 0) return 0;
  refuse("pthread_mutex_clocklock (a timed mutex)");
  return ETIMEDOUT;
}

#define RWLOCK(name, try, parameters, arguments) \
  PUBLIC int name parameters { \
    REAL(name); \
    if (!simulated(CALLER)) return real arguments; \
    if (try(lock) == 0) return 0; \
    refuse(#name); \
    return ETIMEDOUT; \
  }
RWLOCK(pthread_rwlock_timedrdlock, pthread_rwlock_tryrdlock,
       (pthread_rwlock_t *lock, const struct timespec *t), (lock, t))
RWLOCK(pthread_rwlock_timedwrlock, pthread_rwlock_trywrlock,
       (pthread_rwlock_t *lock, const struct timespec *t), (lock, t))
RWLOCK(pthread_rwlock_clockrdlock, pthread_rwlock_tryrdlock,
       (pthread_rwlock_t *lock, clockid_t clock, const struct timespec *t), (lock, clock, t))
RWLOCK(pthread_rwlock_clockwrlock, pthread_rwlock_trywrlock,
       (pthread_rwlock_t *lock, clockid_t clock, const struct timespec *t), (lock, clock, t))

PUBLIC int sigtimedwait(const sigset_t *set, siginfo_t *info, const struct timespec *t) {
  REAL(sigtimedwait);
  if (t && simulated(CALLER)) refuse("sigtimedwait");
  return real(set, info, t);
}

PUBLIC int setsockopt(int file, int level, int name, const void *value, socklen_t size) {
  REAL(setsockopt);
  if (level == SOL_SOCKET && (name == SO_RCVTIMEO || name == SO_SNDTIMEO) && simulated(CALLER))
    refuse("setsockopt with SO_RCVTIMEO or SO_SNDTIMEO");
  return real(file, level, name, value, size);
}

PUBLIC int timerfd_settime(int file, int flags, const struct itimerspec *t, struct itimerspec *before) {
  REAL(timerfd_settime);
  if (simulated(CALLER)) refuse("timerfd_settime");
  return real(file, flags, t, before);
}

PUBLIC int timer_settime(timer_t timer, int flags, const struct itimerspec *t, struct itimerspec *before) {
  REAL(timer_settime);
  if (simulated(CALLER)) refuse("timer_settime");
  return real(timer, flags, t, before);
}

PUBLIC int setitimer(__itimer_which_t which, const struct itimerval *t, struct itimerval *before) {
  REAL(setitimer);
  if (simulated(CALLER)) refuse("setitimer");
  return real(which, t, before);
}

PUBLIC unsigned alarm(unsigned seconds) {
  REAL(alarm);
  if (simulated(CALLER)) refuse("alarm");
  return real(seconds);
}
