"""Read sequences; read and write trajectories, maps and run folders."""
