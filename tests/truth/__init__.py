"""One command that judges the diagnosis: `make truth`. Generated cases, real rigs, other people's systems; old beside new."""
