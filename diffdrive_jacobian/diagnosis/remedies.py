"""What to do about topics that nobody reads or publishes, or that have several publishers."""

START_READER = {
    'cmd_vel': 'start virtual_robot, wheel_bridge or the driver of your robot',
    'joint_command': 'start virtual_robot with -p command_interface:=wheels, or your motor driver',
    'goal_pose': 'start go_to_goal',
    'goals': 'start go_to_goal',
}
"""What to start where nobody is subscribed to a topic, by its base name."""
START_PUBLISHER = {
    'odom': 'start virtual_robot or the driver of your robot',
    'joint_command': 'start wheel_bridge (or the robot without command_interface:=wheels)',
}
"""What to start where nobody publishes a topic, by its base name."""
SAME_NAMES = 'in the same namespace, or remap the topic ({}:=NAME)'
ONE_PUBLISHER = {
    'odom': 'their poses alternate; stop one of them, or give each robot a namespace (-r __ns:=/NAME)',
    'joint_command': 'their commands alternate; stop one of them, or give each robot a namespace',
    'start_pose': 'give each robot a namespace (-r __ns:=/NAME)',
    'goal_status': 'two controllers drive one robot; stop one of them, or give each a namespace',
}
"""What to do about several publishers of a topic that should have one, by its base name."""
