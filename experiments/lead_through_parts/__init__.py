"""Parts of the lead-through study."""
