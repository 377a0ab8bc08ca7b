"""Views for people: dashboard, monitor, metrics and the demo."""
