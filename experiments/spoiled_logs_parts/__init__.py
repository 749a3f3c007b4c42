"""The parts of `experiments/spoiled_logs.py`: sound logs from an independent simulator, and what spoils them."""
