"""Running a suite: its episodes, in one process or many, and again."""
