"""What collect, deploy and replay share: a run of a robot in processes of its own."""
