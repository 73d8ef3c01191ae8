"""The paper's estimator, and code that only the paper's study uses."""
