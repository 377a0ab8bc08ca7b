"""Files: YAML with line and column, writing whole or not at all, those that come with the program."""
