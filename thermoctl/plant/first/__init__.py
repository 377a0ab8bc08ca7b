"""First plant files, from a recording or a template."""
