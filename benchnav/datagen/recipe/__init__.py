"""What is to be made: recipes, scenarios and the class table."""
