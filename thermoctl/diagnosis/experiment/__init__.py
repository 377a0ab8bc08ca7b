"""The experiment that separates hypotheses which fit about as well."""
