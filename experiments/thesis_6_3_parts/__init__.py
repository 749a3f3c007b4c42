"""Parts of thesis_6_3.py."""
