"""Form finding: the rest shape of a stretched sheet on a closed rim, inflated by the fluid's pressure."""
