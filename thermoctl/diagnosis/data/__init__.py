"""The recordings of a diagnosis as rows: outliers, blocks, frequencies, and what earlier recordings left."""
