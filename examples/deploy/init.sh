#!/bin/bash
# PID 1 of a container: starts mavbridge, passes signals on, and ends only when the guard has ended, too.

# Whether a process is left whose parent is this one: the guard of a dead mavbridge becomes one.
has_children() {
  local file key value
  for file in /proc/[0-9]*/status; do
    while read -r key value; do
      [[ $key == PPid: ]] || continue
      [[ $value == "$$" ]] && return 0
      break
    done 2> /dev/null < "$file"
  done
  return 1
}

# Before the start: a signal may come at once.
asked= flight=
trap 'asked=yes; [[ -z $flight ]] || kill -TERM "$flight" 2> /dev/null' TERM INT
mavbridge "$@" &
flight=$!
[[ -z $asked ]] || kill -TERM "$flight" 2> /dev/null

# A signal interrupts the wait while the process is still there.
while :; do
  wait "$flight"
  status=$?
  kill -0 "$flight" 2> /dev/null || break
done
# If it ended just after a signal, its own status is still to be had: 127 = that was it already.
wait "$flight" 2> /dev/null
again=$?
((again == 127)) || status=$again

# The guard ends by itself, some only when the vehicle is disarmed; the container's stop timeout is the limit.
while has_children; do
  sleep 0.2
done
exit "$status"
