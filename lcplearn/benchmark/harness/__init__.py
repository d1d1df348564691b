"""How every study is kept, timed, drawn and reported; knows nothing of what is measured."""
