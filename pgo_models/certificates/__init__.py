"""A proven lower bound on F for anybody's poses."""
