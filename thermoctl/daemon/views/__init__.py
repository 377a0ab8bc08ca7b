"""Views for people: dashboard, monitor, metrics, MQTT and the demo."""
