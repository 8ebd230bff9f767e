"""Generated teleoperation: operators, their sessions, and what an arm's sensors make of them."""
