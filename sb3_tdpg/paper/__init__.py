"""What only the reproduction of the paper's tables needs; nothing else imports it but the command line."""
