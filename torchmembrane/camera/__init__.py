"""The camera: pixels to rays and back, through lens, ports and medium."""
