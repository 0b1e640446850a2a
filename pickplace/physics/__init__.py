"""Plans carried out in MuJoCo, which knows none of our rules."""
