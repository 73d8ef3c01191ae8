"""Code that only the paper's study needs: the Monge form, and the one-dimensional membrane."""
