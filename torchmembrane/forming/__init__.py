"""Form finding: the rest shape of a stretched sheet on a closed rim, blown up by the fluid's pressure."""
