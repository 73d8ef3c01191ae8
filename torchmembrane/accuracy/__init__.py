"""What to expect of a sensor: presses simulated on it, reconstructed from their images, and summed up in a spec sheet."""
