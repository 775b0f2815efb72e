"""Rotations in SO(d), poses in SE(d)^n and the Stiefel manifold, as read-only arrays."""
