"""A check of written proofs in ball arithmetic; of other rooms it imports `errors` alone."""
