"""The game: rounds of Alice and Bob on a batch of worlds, and what an actor ships of them. No torch in here."""
