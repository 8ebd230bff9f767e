"""What a remote solver and its server share: the form of their messages, their addresses and keys."""
