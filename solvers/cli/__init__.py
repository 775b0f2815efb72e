"""The command `pgo`: one file per command, their options and inputs, signals and pipes."""
