"""Settings, one module a command: a field is a flag, its docstring the help text."""
