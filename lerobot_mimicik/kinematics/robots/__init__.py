"""Robot descriptions shipped with the package (package data)."""
