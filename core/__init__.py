"""What is true of modes whatever the solver: numpy, scipy and h5py only."""
