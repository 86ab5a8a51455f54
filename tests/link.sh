#!/bin/sh
# Measures the wall's frame rate over links of limited rate, and the delay of a motion over a slow one. The links run
# between two network namespaces, which needs root. Takes a picture of 1024x512 samples, for example of the dragon:
#
#     cargo build --release && cargo build --release -p lab --examples
#     sudo sh tests/link.sh picture.png
set -e
picture=$1
far=raywall-far
measure() {
    target/release/examples/link_rate --alone --listen 10.99.0.1:0 --through "ip netns exec $far" --replay "$picture" "$@"
}
trap 'ip netns del $far' EXIT
ip netns add $far
ip link add raywall-near type veth peer name raywall-peer
ip link set raywall-peer netns $far
ip addr add 10.99.0.1/24 dev raywall-near
ip link set raywall-near up
ip netns exec $far ip addr add 10.99.0.2/24 dev raywall-peer
ip netns exec $far ip link set raywall-peer up
for rate in 680mbit 10gbit; do
    ip netns exec $far tc qdisc replace dev raywall-peer root tbf rate $rate burst 256kb latency 20ms
    echo "== $rate, raw"
    measure --encoding raw
    echo "== $rate, as measured to be faster"
    measure
done

ip netns exec $far tc qdisc replace dev raywall-peer root tbf rate 100mbit burst 32kb latency 20ms
echo "== 100mbit, motions"
for nodes in 1 4 12; do
    target/release/examples/motion_delay --nodes $nodes --listen 10.99.0.1:0 --through "ip netns exec $far"
done

ip netns exec $far tc qdisc replace dev raywall-peer root tbf rate 680mbit burst 256kb latency 20ms
tc qdisc replace dev raywall-near root tbf rate 680mbit burst 256kb latency 20ms
echo "== 680mbit both ways, frames while a scene travels"
target/release/examples/transfer_delay --rounds 24 --frames 80 --listen 10.99.0.1:0 --through "ip netns exec $far"
