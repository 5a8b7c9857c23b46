"""Training samples, and what is done with them."""
