"""One camera, followed as it goes: the newest frame is reconstructed, older ones are dropped rather than waited for."""
