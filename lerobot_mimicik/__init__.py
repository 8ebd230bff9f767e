"""MimicIK: generative inverse kinematics learned from teleoperation, as a LeRobot policy."""

__version__ = "0.1.0"
