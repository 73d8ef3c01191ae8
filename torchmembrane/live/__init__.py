"""Live cameras: the newest frame is reconstructed; frames that arrive during a reconstruction are dropped."""
