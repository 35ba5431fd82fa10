"""Materials of flat samples from one or several captures: made at random, photographed, estimated, written."""
