"""Parts of the camera study."""
