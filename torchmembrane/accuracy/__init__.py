"""Expected accuracy of a sensor: simulated presses are reconstructed from their images and summarised in a spec sheet."""
