"""Datasets: synthetic teleoperation, retargeting, statistics and fast loading."""
