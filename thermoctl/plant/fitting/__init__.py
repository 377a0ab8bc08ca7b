"""Plants beside recordings: residuals and their slopes, refit, estimated inputs, noise."""
