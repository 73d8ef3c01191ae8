"""The steps of force balance as machine code, on a processor where no gradient is recorded."""
