"""The steps of force balance as machine code, for processors and without gradients."""
