"""What stands between a solver and an arm: steps in a box, the closest configuration, branches."""
