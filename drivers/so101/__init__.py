"""The SO-101 arm: facts and a light model."""
