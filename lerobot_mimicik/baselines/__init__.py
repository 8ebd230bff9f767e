"""Learned baselines of the paper as LeRobot policies: same data, conditioning and limits as MimicIK."""
