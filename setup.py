# Copyright 2026 The diffdrive_jacobian developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Package diffdrive_jacobian, for colcon and for pip."""

from glob import glob
from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.sdist import sdist

PACKAGE = 'diffdrive_jacobian'
COMMANDS = [
    'virtual_robot',
    'go_to_goal',
    'wheel_bridge',
    'drive_to',
    'send_goal',
    'send_path',
    'record_run',
    'recover_run',
    'replay_run',
    'verify_run',
    'watch_run',
    'plot_jacobian',
    'plot_run',
    'sweep_gains',
    'doctor',
    'calibrate_run',
    'grade_hand_ins',
]
NOT_IN_PACKAGE = ('doc', 'test', 'config', 'resource', '.ci', '.github')
"""Folders that a source distribution has beside the package."""
MESSAGES = '5.3.6'
CORE_MESSAGES = '2.0.3'


class SourceDistribution(sdist):
    """With the tests and the pages, as a clone has them."""

    def make_distribution(self):
        """Add what is no part of the package."""
        files = (path for folder in NOT_IN_PACKAGE for path in Path(folder).rglob('*'))
        kept = (path for path in files if path.is_file() and '__pycache__' not in path.parts)
        beside = ('CHANGELOG.rst', 'LICENSE', 'package.xml', '.mypy.ini', '.ruff.toml')
        self.filelist.extend(sorted([*map(str, kept), *beside]))
        super().make_distribution()


setup(
    name=PACKAGE,
    version='0.1.0',
    description='A virtual differential-drive robot, driven to goals through the mobile-robot Jacobian.',
    long_description=Path('README.md').read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    keywords=['ROS', 'differential drive', 'mobile robot', 'Jacobian', 'simulation', 'testing'],
    classifiers=[
        'Development Status :: 4 - Beta',
        'Framework :: Pytest',
        'Intended Audience :: Developers',
        'Intended Audience :: Education',
        'Intended Audience :: Science/Research',
        'Operating System :: OS Independent',
        'Programming Language :: Python :: 3.10',
        'Programming Language :: Python :: 3.11',
        'Programming Language :: Python :: 3.12',
        'Programming Language :: Python :: 3.13',
        'Topic :: Education',
        'Topic :: Scientific/Engineering',
        'Topic :: Software Development :: Testing',
        'Typing :: Typed',
    ],
    cmdclass={'sdist': SourceDistribution},
    author='The diffdrive_jacobian developers',
    author_email='maintainers@example.com',
    license='Apache-2.0',
    packages=find_packages(include=[PACKAGE, f'{PACKAGE}.*']),
    package_data={
        PACKAGE: ['py.typed', 'ros/fastdds/*.xml', 'lockstep/external/*.c'],
        f'{PACKAGE}.live': ['page/*'],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        (f'share/{PACKAGE}/config', sorted(glob('config/*.yaml'))),
    ],
    python_requires='>=3.10',
    install_requires=[
        'mcap>=1.6',
        'numpy>=1.24',
        'rich>=12',
        'rosbags>=0.11.9,<0.12',
        'ruamel.yaml>=0.17',
        # Its parser in C, with which a bag is opened in a fraction of the time.
        'ruamel.yaml.clib>=0.2.8; platform_python_implementation=="CPython"',
        # rosbags brings these, too; the tools import them themselves.
        'apsw',
        'backports.zstd; python_version<"3.14"',
        'lz4',
    ],
    # rclpy is not required here: a ROS installation brings its own, under another name than PyPI's.
    extras_require={
        'jazzy': [
            'ros-rclpy[fastrtps]==7.1.6',
            'ros-rmw-fastrtps-cpp==8.4.3',
            f'ros-action-msgs=={CORE_MESSAGES}',
            f'ros-builtin-interfaces=={CORE_MESSAGES}',
            f'ros-geometry-msgs=={MESSAGES}',
            f'ros-nav-msgs=={MESSAGES}',
            f'ros-rcl-interfaces=={CORE_MESSAGES}',
            f'ros-rosgraph-msgs=={CORE_MESSAGES}',
            f'ros-sensor-msgs=={MESSAGES}',
            f'ros-std-msgs=={MESSAGES}',
            f'ros-std-srvs=={MESSAGES}',
            'ros-unique-identifier-msgs==2.5.0',
        ],
        'testing': ['hypothesis>=6', 'pytest>=7'],
        'doc': ['pdoc>=15'],
        'explore': ['hypothesis>=6'],
        'live': ['segno>=1.5', 'websockets>=15'],
        'plot': ['matplotlib>=3.5'],
        'test': [
            'distributed',
            'hypothesis>=6',
            'matplotlib>=3.5',
            'pytest>=7',
            'pytest-xdist>=3',
            'pyyaml>=5',
            'segno>=1.5',
            'websockets>=15',
        ],
    },
    zip_safe=False,
    entry_points={
        'console_scripts': [
            *(f'{name} = {PACKAGE}.tools.entry_points:{name}' for name in COMMANDS),
            # Other packages have a doctor, too.
            f'diffdrive_doctor = {PACKAGE}.tools.entry_points:doctor',
        ],
        # Each name is that of the module, so that `pytest_plugins` with it does not load it twice.
        'pytest11': [
            f'{module} = {module}'
            for module in (
                f'{PACKAGE}.testing.fixtures',
                f'{PACKAGE}.robot_testing.fixtures',
                f'{PACKAGE}.grading.plugin',
            )
        ],
        f'{PACKAGE}.fault_kinds': [f'robot = {PACKAGE}.robot_testing.fault_kinds:KINDS'],
        f'{PACKAGE}.pictures': [f'run = {PACKAGE}.robot_testing.pictures:draw_run'],
    },
)
