"""rosbridge: the JSON protocol of roslibjs and roslibpy, as far as it is about actions."""
