"""The result of a reconstruction, and folders of results: how they are stored and read."""
