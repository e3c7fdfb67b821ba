"""The command line: a file for each group of commands. Each command parses, makes one call and returns an exit code."""
