"""The motion that answers the open questions of a diagnosis."""
