"""The semidefinite relaxation in all its forms."""
