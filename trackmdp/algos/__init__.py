"""Learning methods: loss, optimizer and update of one algorithm per file."""
