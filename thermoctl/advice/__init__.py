"""Help before a diagnosis: the effects that it could see, and checks of effect files."""
