"""Safe reading and writing of files: reads are bounded, writes are atomic, and results record their source."""
