"""The camera model: from pixels to rays and back, through lens, ports and medium."""
