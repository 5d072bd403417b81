"""What a calibration is judged by."""
