"""What a reconstruction is, and how a folder of them is kept and read."""
