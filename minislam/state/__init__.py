"""What an interrupted run needs to go on: the state of its parts, and the steps it has done."""
