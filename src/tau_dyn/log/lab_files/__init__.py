"""Files of measuring and computing software: MATLAB, universal files."""
