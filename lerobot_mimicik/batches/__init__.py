"""A LeRobot dataset made into tensors for training."""
