"""Robots, drivers and safety between an end-effector policy and a real arm."""
