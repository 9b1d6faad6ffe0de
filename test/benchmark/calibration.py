"""Calibration of simulated robots that drive UMBmark, compared with the Cramer-Rao bound.

    python test/benchmark/calibration.py [--robots 500]

Each robot has other wheels (multipliers within 3 %), slips by the documented noise model (1e-5 m) and
is observed at 2 Hz with 5 mm and 0.01 rad. Noise, place of the sensor and time offset are unknown to
the calibration. Prints a table: rms error over the bound, bias, and the mean of the normalized squared
errors (NEES), each with the standard deviation that chance gives it.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from calibration_data import NOISE, NOMINAL, Drive, Simulation, umbmark

from diffdrive_jacobian.calibration import PARAMETERS, calibrate
from diffdrive_jacobian.calibration.estimate import Estimate
from diffdrive_jacobian.calibration.fit import information

SPREAD = 0.03
"""Multipliers are drawn from 1 plus and minus this."""


def one_robot(robot, seed):
    """Return error, bound and NEES of the logarithms of the multipliers, and the CPU time (s)."""
    random = np.random.default_rng(seed)
    multipliers = tuple(random.uniform(1.0 - SPREAD, 1.0 + SPREAD, 3).tolist())
    robot = replace(robot, multipliers=multipliers)
    state = random.bit_generator.state
    recording = robot.recording(random)
    begin = time.process_time()
    result = calibrate([recording], NOMINAL)
    seconds = time.process_time() - begin
    error = result.estimate.parameters[:3] - np.log(multipliers)
    nees = error @ np.linalg.solve(result.estimate.covariance()[:3, :3], error)
    random.bit_generator.state = state
    truth, motion = robot.truth(random), result.motions[0]
    known = Estimate(
        parameters=np.array([*np.log(multipliers), 0.0, 0.0, 0.0, 0.0]),
        noise=NOISE,
        free=np.ones(7, dtype=bool),
        states=(np.column_stack([np.interp(motion.time, robot.drive.time, one) for one in truth.T]),),
        information=np.zeros((0, 0)),
    )
    bound = np.diag(np.linalg.inv(information([motion], NOMINAL, known)))[:3]
    return error, bound, nees, seconds


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--robots', type=int, default=500, help='number of robots (default: 500)')
    count = parser.parse_args().robots
    robot = Simulation(drive=Drive.of(umbmark()), rate=25)
    rows = [one_robot(robot, seed) for seed in range(count)]
    errors, bounds = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    nees, seconds = np.array([row[2] for row in rows]), np.array([row[3] for row in rows])
    ratio = np.sqrt(np.mean(errors**2 / bounds, axis=0))
    deviation = np.sqrt(np.mean(errors**2, axis=0))
    print(f'{count} robots, UMBmark of {robot.drive.time[-1]:.0f} s each')
    print(f'{"":32}{"rms error":>10}{"/ bound":>16}{"bias":>20}')
    for index, name in enumerate(PARAMETERS):
        bias, chance = errors[:, index].mean(), deviation[index] / np.sqrt(count)
        print(
            f'{name:32}{100 * deviation[index]:9.4f}%{ratio[index]:9.3f} ± {0.5**0.5 / count**0.5:.3f}'
            f'{100 * bias:+11.4f} ± {100 * chance:.4f}%'
        )
    print(f'mean NEES: {nees.mean():.3f} ± {np.sqrt(6.0 / count):.3f} (3 is right)')
    print(f'CPU time of a calibration: median {np.median(seconds):.2f} s, all {seconds.sum():.0f} s')


if __name__ == '__main__':
    main()
