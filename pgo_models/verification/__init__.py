"""A check of written proofs in ball arithmetic, which imports nothing of other rooms but errors."""
