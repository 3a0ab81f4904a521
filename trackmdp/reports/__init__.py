"""What is made of results: pictures."""
