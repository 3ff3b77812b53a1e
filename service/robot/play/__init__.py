"""A live world in the browser: who plays, the game, what is drawn, the controls, the server."""
