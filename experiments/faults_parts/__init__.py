"""What `experiments/faults.py` does to processes, and how it judges what they leave."""
