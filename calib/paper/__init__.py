"""Algorithm 1 of the DEAL paper: critic, diffusion evolution, fitness of rollouts."""
