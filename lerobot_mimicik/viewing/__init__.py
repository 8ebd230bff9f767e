"""An arm to look at and to play with: what happens (`session`, `motions`), and how a browser shows it (`page`, `scene`)."""
