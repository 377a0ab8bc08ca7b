"""The result of a diagnosis in words, tables and figures."""
