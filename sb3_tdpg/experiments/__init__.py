"""Train and evaluate models from blocks of settings on one or many machines; interrupted experiments can be resumed."""
