"""The paper: its estimator, and the studies that only it needs."""
