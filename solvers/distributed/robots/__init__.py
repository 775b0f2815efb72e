"""What one robot knows and does."""
