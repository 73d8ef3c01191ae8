"""Other programs' formats and viewers, each an extra."""
