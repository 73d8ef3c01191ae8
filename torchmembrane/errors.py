"""The one exception family of torchmembrane."""


class MembraneError(ValueError):
    """A wrong file, value or shape; the message says what came, what was expected and the remedy."""
