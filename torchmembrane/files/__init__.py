"""Reading and writing files one can trust: within bounds, whole or not at all, with what they came from."""
