"""The bench screen: the state of a running session, and keys that answer its questions.

`bench_state` collects events and `screen_text` describes the state; neither needs a screen. `bench_screen`
(the screen and its dialogs) needs textual, the extra `bench`.
"""
