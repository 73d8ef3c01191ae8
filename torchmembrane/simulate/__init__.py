"""The forward problem: a membrane pressed by rigid indenters."""
