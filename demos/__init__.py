"""Environment to verified demonstrations and a LeRobot dataset."""
