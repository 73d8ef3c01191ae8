"""Force balance: few, compressive contact forces explain what the markers show."""
