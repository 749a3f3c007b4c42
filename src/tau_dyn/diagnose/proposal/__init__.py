"""The motion that answers what a diagnosis left open."""
