"""Search for handedness terms: matrices P >= 0 that make a certificate matrix definite."""
