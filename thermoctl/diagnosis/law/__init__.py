"""An unknown law of the remainder: proposed, refitted, weighed and written."""
