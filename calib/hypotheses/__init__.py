"""What a residual may mean: hypotheses on a robot and its recordings, and the one judge that accepts them."""
