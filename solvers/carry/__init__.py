"""What carries messages between robots: this process, Ray, Zenoh; and what counts them."""
