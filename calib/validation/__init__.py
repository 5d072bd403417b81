"""What a fit is worth: its uncertainty, the causes of its residual, and the verdict on its use."""
