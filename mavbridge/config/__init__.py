"""Settings of the commands. Each field is a flag; its docstring is the help text."""
