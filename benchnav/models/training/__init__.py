"""Training of models: data, training loop, and the checkpoint that receives the result."""
