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

// A node that lives by wall time: it says every 20 ms for how long it has run. argv: how it waits.
#include <chrono>
#include <condition_variable>
#include <cstdio>
#include <future>
#include <mutex>
#include <string>
#include <thread>

#include "rclcpp/rclcpp.hpp"
#include "std_msgs/msg/string.hpp"

using namespace std::chrono_literals;
using std_msgs::msg::String;

int main(int argc, char ** argv)
{
  const auto arguments = rclcpp::init_and_remove_ros_arguments(argc, argv);
  const std::string how = arguments.at(1);
  auto node = std::make_shared<rclcpp::Node>("ticker");
  auto publisher = node->create_publisher<String>("tick", 100);
  const auto begin = std::chrono::steady_clock::now();
  auto tick = [&]() {
    char text[32];
    std::snprintf(
      text, sizeof text, "%.3f",
      std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count());
    String message;
    message.data = text;
    publisher->publish(message);
  };
  std::mutex mutex;
  std::condition_variable condition;
  std::promise<void> promise;
  auto future = promise.get_future();
  auto wait = [&]() {
    std::unique_lock<std::mutex> lock(mutex);
    if (how == "sleep") {
      std::this_thread::sleep_for(20ms);
    } else if (how == "sleep_until") {
      std::this_thread::sleep_until(std::chrono::system_clock::now() + 20ms);
    } else if (how == "condition") {
      condition.wait_for(lock, 20ms);
    } else if (how == "system") {
      condition.wait_until(lock, std::chrono::system_clock::now() + 20ms);
    } else {
      future.wait_for(20ms);
    }
  };
  rclcpp::TimerBase::SharedPtr timer;
  std::thread thread;
  if (how == "timer") {
    timer = node->create_wall_timer(20ms, tick);
  } else if (how == "rate") {
    rclcpp::WallRate rate(50.0);
    while (rclcpp::ok()) {
      rclcpp::spin_some(node);
      rate.sleep();
      tick();
    }
  } else {
    thread = std::thread([&]() {
      while (rclcpp::ok()) {
        wait();
        tick();
      }
    });
  }
  if (rclcpp::ok()) {
    rclcpp::spin(node);
  }
  if (thread.joinable()) {
    thread.join();
  }
  rclcpp::shutdown();
}
