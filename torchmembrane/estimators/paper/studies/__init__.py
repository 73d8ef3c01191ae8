"""What only the paper's study needs: the Monge form, one dimension."""
