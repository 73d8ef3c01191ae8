"""Force balance: sparse, compressive contact forces explain the observed markers."""
