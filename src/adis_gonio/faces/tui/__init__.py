"""The bench screen: what a running session tells, at a glance, and keys that answer it.

`state` collects events, `words` says them as lines, `glyphs` draws the large angle; these three know no
screen. `bench` (the screen), `dialogs` and `face` need textual, the extra `bench`.
"""
