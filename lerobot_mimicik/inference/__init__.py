"""One step of a policy for one arm, and the engines that compute it."""
