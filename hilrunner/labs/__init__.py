"""Labs: a real CAN bus of a kernel for the time of one command, on any machine. Python standard library only.

`command` tries them in order: native vcan (`native`), a kernel that is an ordinary program (`uml`, with `guest` as its process 1
and `preload` for hosts it would not start on), an emulated PC (`qemu`).
"""
