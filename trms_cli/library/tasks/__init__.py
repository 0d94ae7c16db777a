"""What each composing command does, of a composed configuration, without a word on the screen."""
