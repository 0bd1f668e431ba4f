"""The pose check by pictures alone: matches between views and what explains them."""
