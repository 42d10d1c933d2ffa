"""The command line: arguments, exit codes and what the screen says."""
