"""What one robot knows and does, the driver of robots, and the places where they solve."""
