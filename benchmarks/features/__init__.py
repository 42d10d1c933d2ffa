"""What each part of a training step costs and gains."""
