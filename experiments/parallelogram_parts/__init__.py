"""Parts of the study of the calibration paper's planar parallelogram."""
