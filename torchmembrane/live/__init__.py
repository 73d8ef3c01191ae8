"""A live camera: the newest frame is reconstructed, and frames that arrive during a reconstruction are dropped."""
